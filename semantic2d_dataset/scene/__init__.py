"""What is measured: lidars, classes, geometry, maps, scans and the lines in them."""
