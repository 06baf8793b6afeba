"""The posterior of ``UncertainDepth``: p(depth | network, UfM*, anchors), a depth that anchors correct."""
