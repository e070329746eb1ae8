"""Parts of `xrl play`: what is read, what of it is put where, and when."""
