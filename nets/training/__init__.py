"""Training: captures drawn and stored, batches, losses, runs, calibration."""
