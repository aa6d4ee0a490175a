"""Labelled sequences to trained models and predictions."""
