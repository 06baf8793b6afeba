"""``ufmstar poses``: poses, landmarks and their scale from images alone, by structure from motion (pycolmap)."""
