"""`xrl topic`: what is on the bus."""
