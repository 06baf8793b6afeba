"""The loop over frames and its parts: alternating networks, estimators, anchors, the clock."""
