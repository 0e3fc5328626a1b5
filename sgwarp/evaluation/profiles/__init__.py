"""Published protocols, one module each; `catalogue` names them."""
