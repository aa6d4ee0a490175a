"""Published layouts of one file for each scan: trees and archives of files, and what they mean."""
