"""What every plant end promises, as tests for one's own: `pytest --pyargs service.contract --hil-plant=can`."""
