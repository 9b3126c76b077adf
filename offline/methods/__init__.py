"""The methods that a speed-accuracy chart sets side by side; see ``offline.methods.method``."""
