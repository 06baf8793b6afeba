"""GPU kernels in Triton, behind the types of ``ufmstar_torch.step``; ``TRITON_INTERPRET=1`` runs them on the CPU."""
