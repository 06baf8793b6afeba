"""The steps of the algorithm again, faster: same signatures as the torch reference (see ``ufmstar_torch.backend``)."""
