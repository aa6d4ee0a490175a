"""What a recording holds, before it is converted."""
