"""Streaming real-time gyro compensation: CAN frames in, corrected rates out."""

__version__ = "0.1.0"
