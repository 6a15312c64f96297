"""Physics says yes or no: simulation of a planned motion and the goals that judge it."""
