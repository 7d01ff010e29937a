"""The field kit: a folder that times networks on a device out of reach, and what comes of it."""
