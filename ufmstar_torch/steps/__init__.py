"""The paper, step by step, in torch: the reference of every faster implementation, on every device."""
