"""Files of strangers, read with bounded memory and without running code, and files written atomically."""
