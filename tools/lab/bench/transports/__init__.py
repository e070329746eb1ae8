"""Ways between processes of one host that `xrl bench bus` runs the fleet's pattern over."""
