"""Sessions of a tool at 1 kHz over WebSocket."""
