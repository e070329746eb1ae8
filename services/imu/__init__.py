"""IMU service: computes the up direction from the sensor's orientation."""
