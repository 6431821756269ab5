/*
 * For linux.uml of Debian 12 on processors with AMX: its tables of a process's floating-point registers have no room
 * for the tiles, and a kernel of the host takes back the whole of them only (ptrace, NT_X86_XSTATE: EFAULT), so that
 * no guest starts. What is missing is put behind: the tiles are as they were, and nobody in the guest uses them.
 */
#define _GNU_SOURCE
#include <elf.h>
#include <errno.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

long ptrace(enum __ptrace_request request, ...)
{
    va_list arguments;
    va_start(arguments, request);
    pid_t pid = va_arg(arguments, pid_t);
    void *address = va_arg(arguments, void *), *data = va_arg(arguments, void *);
    va_end(arguments);

    if (request == PTRACE_SETREGSET && (long)address == NT_X86_XSTATE) {
        static char whole[1 << 16];
        struct iovec *given = data, all = {whole, sizeof whole};
        if (syscall(SYS_ptrace, PTRACE_GETREGSET, pid, address, &all) == 0 && given->iov_len < all.iov_len) {
            memcpy(whole, given->iov_base, given->iov_len);
            return syscall(SYS_ptrace, request, pid, address, &all);
        }
    }

    /* As the C library has it: these return the word that they read. */
    long word;
    int peeks = request == PTRACE_PEEKTEXT || request == PTRACE_PEEKDATA || request == PTRACE_PEEKUSER;
    long result = syscall(SYS_ptrace, request, pid, address, peeks ? (void *)&word : data);
    if (peeks && result >= 0) {
        errno = 0;
        return word;
    }
    return result;
}
