"""What training steps, simulated scans and feature grids cost, measured on the machine at hand."""
