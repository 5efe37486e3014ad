"""What rides along with light: derivatives, those of blocks of cells, polarisation."""
