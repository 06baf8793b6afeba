"""Extension that ``UncertainDepth`` switches on: p(depth | network, UfM*, anchors), a depth that anchors correct."""
