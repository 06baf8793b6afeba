"""p(depth | network, UfM*, anchors), an extension that is off by default: a depth that anchors have corrected."""
