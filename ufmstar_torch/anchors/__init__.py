"""Anchors, an extension that is off by default: sparse depths that show the error on which all views agree."""
