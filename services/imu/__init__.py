"""The IMU service: the sensor's orientation in, which way is up out."""
