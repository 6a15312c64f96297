"""Stand-ins of the nodes and of the arm, and the strategy server among them: what the tests of several packages share."""
