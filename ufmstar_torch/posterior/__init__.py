"""Extension, off by default: p(depth | network, UfM*, anchors), a depth map corrected by anchors."""
