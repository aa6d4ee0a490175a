"""Predictions to validated, scored, ranked and published results."""
