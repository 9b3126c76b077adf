"""The methods that the studies compare; see ``offline.methods.method``."""
