"""Recordings of messages: what every bag or log offers, and how it becomes sequences."""
