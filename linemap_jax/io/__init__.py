"""Files and pictures: logs in, maps out."""
