"""The demonstration: a synthetic street, traversed twice, and its plots."""
