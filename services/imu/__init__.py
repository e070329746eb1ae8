"""IMU service: the sensor's orientation in, the up direction out."""
