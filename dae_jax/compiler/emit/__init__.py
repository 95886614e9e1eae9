"""From LLVM's intermediate representation to machine code that XLA calls."""
