"""Any other arrays, by a description of what they mean."""
