"""How drives and sensors are seen from outside: CAN frames, USB endpoints."""
