"""A frame on its way in and out: arguments, checks, predictions, results, counts and warnings."""
