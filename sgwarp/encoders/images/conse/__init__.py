"""ConSE: an ImageNet classifier and sentence embeddings, the encoder that works offline."""
