"""What is stored: sequences, manifests and splits."""
