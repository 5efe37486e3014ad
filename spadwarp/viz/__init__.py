"""Pictures, pages and videos: arrays in, images out."""
