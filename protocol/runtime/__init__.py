"""Process set-up: node on the network, tick grid, timing statistics, real-time settings, host facts."""
