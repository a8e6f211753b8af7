"""Hard cases: data, settings and scenes on which codecs and renderers break, each with the
properties that must hold."""
