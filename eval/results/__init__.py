"""What an evaluation leaves on disk: folders, records, caches, and the processes that write them."""
