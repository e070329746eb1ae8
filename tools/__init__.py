"""The command line `xrl`: one file for each verb."""
