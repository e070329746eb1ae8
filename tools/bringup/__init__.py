"""Bringing a real robot up: boards, settings, zeros, single joints."""
