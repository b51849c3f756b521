"""Processes at the plant end: the emulator, the CAN node and bridge, Quanser's board, and the replay of a trace."""
