"""Foxglove and Lichtblick: decoded topics, their schemas, a layout, and a live WebSocket server."""
