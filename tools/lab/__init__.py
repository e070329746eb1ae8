"""The laboratory, for researchers: design of the gains. No robot in service needs it."""
