"""``ufmstar report``: tables, figures and one page from the results of ``ufmstar eval`` (imported lazily)."""
