"""From labelled sequences to a published data set, and what others need to judge it."""
