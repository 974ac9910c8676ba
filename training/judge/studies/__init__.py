# SPDX-License-Identifier: Apache-2.0
"""Studies of `paul study`: questions about the method, each answered by a table and a picture."""
