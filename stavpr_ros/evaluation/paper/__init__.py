"""The paper's data sets and tables."""
