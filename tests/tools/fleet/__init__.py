"""Tests of the fleet: process table, supervision, proxy client."""
