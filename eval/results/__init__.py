"""What an evaluation or a run leaves on disk: folders, records, caches, and the processes that write them."""
