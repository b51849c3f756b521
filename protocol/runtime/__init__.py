"""Process set-up: role on the network, tick grid, timing statistics, real-time settings, host facts."""
