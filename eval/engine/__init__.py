"""The loop over frames and what runs in it: networks in turn, estimators, anchors, the clock."""
