"""Points in, packets out."""
