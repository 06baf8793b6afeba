"""Names of the sources of anchors, as users write them."""

CORNERS, DENSE = "corners", "dense"
FILE_TYPES = (".csv", ".txt", ".npz")  # of files of landmarks
