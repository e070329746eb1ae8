"""Design of the gains by `xrl gains`: their schedule, certificates, and withstood pushes."""
