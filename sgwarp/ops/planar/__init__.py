"""The same for splats that others have projected: the stages behind the facades."""
