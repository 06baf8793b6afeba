"""Support of modules: checked settings, state in buffers, one caller at a time, lazy imports, warm-up, CUDA graphs."""
