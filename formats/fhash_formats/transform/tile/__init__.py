"""One tile to bytes and back: settings, sections of the stream, encoder, decoder."""
