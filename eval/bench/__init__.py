"""``ufmstar bench`` and the efficiency tables: time, energy and memory."""
