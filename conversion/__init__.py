"""Recordings of any kind to unlabelled sequences."""
