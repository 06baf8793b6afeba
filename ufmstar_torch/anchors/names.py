"""Names of the sources of anchors, as users write them; apart, because help texts need them without torch."""

CORNERS, DENSE = "corners", "dense"
FILE_TYPES = (".csv", ".txt", ".npz")  # of files of landmarks
