"""Exact truth: simulated buildings, people and lidars."""
