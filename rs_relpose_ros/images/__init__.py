"""Published images as data: encodings, headers of compressed ones, decoding."""
