"""The controller process, and what both daemons share: choice of the plant end."""
