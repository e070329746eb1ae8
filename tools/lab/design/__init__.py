"""Design of the gains by `xrl gains`: their schedule, its certificates, what pushes they bear."""
