"""What the MAGIC packages share: geometry, errors, strategies, objects, conversions."""
