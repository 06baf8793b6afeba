"""Training of the networks: the layer's place; its modules come with the networks' own release."""
