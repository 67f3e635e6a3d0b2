from .any_format import read_log as read_log
