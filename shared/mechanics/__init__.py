"""One physics for both sizes: tissue laws, loads, contact, equilibrium, stress."""
