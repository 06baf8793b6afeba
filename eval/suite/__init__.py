"""``ufmstar eval``: the paper's rows on the user's own sequences (imported lazily, module by module)."""
