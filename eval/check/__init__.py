"""``ufmstar data check``: whether poses, depth and images of a sequence fit together."""
