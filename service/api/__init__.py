"""Adaptive attitude control over Eclipse Zenoh, in frames whose every bit is a quantizer's bit."""
