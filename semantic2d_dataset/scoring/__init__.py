"""How good it is: the evaluator and the predictions that it scores."""
