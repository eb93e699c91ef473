"""Accuracy against sampling time, and the cost of training steps, measured on this machine."""
