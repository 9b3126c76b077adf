"""Local reduced models: what a query solves."""
