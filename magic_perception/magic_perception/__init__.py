"""From RGB-D frames of a table-top to objects."""
