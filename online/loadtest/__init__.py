"""Load on a service, timed from when each message was due."""
