"""Stands for Quanser's package in processes that tests start."""
