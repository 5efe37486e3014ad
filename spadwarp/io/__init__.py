"""Files that appear whole or not at all: HDF5, EXR, PLY."""
