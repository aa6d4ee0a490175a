"""Sequences and one labelled map to labelled sequences."""
