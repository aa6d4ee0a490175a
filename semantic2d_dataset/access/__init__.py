"""How to get it: known data sets, model inputs and PyTorch Datasets."""
