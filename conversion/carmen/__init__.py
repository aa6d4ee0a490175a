"""CARMEN logs."""
