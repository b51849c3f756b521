"""Quanser's USB board as a plant, its driver, and a fake of Quanser's HIL interface."""
