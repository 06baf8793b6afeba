"""GPU kernels in Triton, behind the types of ``steps.step``; ``TRITON_INTERPRET=1`` runs them on the CPU."""
