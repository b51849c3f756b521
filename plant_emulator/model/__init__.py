"""Emulated plant: equations of motion, rotors, friction, wind, sensors and integration."""
