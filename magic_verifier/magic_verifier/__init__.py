"""Physics says yes or no: simulation of a planned motion and the goal tests that judge it."""
