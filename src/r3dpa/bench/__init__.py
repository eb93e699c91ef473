"""What training steps and simulated scans cost, measured on the machine at hand."""
