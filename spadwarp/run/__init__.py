"""Run directories, and files of any kind that spadwarp writes."""
