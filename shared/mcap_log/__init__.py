"""Logs: write MCAP files, read cut or damaged ones, recover and extend them."""
