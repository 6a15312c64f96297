"""From a matched contact to the motion of the tool and of the arm that holds it."""
