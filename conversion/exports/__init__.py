"""The way back: sequences as ROS 2 recordings and in the published layout."""
