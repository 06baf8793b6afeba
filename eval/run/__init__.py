"""The job, folder, files and summary of ``ufmstar run``; other commands also use ``folder``, ``files``, ``machine``."""
