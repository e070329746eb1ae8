"""CAN frames of drives and sensors, and the emulated bus."""
