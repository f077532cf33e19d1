"""What runs at a desk: recordings, identification, evaluation, the gyro simulator, mismatch diagnosis."""
