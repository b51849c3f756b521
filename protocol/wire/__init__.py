"""Wire format: attitude conventions, quantizers, frames and transmit policy, without I/O."""
