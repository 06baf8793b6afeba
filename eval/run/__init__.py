"""The job, folder, files and summary of ``ufmstar run``; its folder, files and machine serve other commands too."""
