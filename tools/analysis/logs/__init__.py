"""Surveys of logs, without holding them in memory."""
